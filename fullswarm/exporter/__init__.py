"""Metrics of a live swarm for Prometheus (extra ``[metrics]``): one process that observes the bus and sends nothing.

In: HealthReport, RobotMeasurement, Summary, Heartbeat, ProcessReport, RequestStatus, Interventions, Leases,
ChargingStatus. Out: ``/metrics``.

``newest.py``    a node that keeps the newest of everything, bounded, and forgets what is gone
``families.py``  names, units, labels and values of all metrics, made of that at each scrape
``serve.py``     `fullswarm metrics`: the HTTP server
"""
