"""Performance of the swarm (paper II.F). In: poses and contacts of the robots. Out: numbers, files.

A new metric is a column and a quantity in ``metrics.py``, and what fills the column on board: ``calculators.py`` for
what adds up over time, ``agent/telemetry/metrics.py`` for what is sampled. A new termination condition is a field of
``PerformanceConfig`` in ``config/models.py`` and its test in ``termination.py``.

======================  ==========================================================  =============
file                    what it holds                                               runs in
======================  ==========================================================  =============
``metrics.py``          the table of metrics: columns, quantities, their meaning    core
``calculators.py``      distance, contacts, energy and covered cells per robot      agent
``coverage.py``         the coverage grid and how it travels on the bus             agent, core
``tallies.py``          joins the measurements of all hosts                         core
``shape.py``            order, spacing, diameter, Lloyd's cost of the swarm         core
``summarizers.py``      measurements of all hosts → a Summary per metric            core
``termination.py``      the termination conditions: when a trial is over            core
``truth.py``            true motion of the bodies, measured and published           base station
``performance_node.py`` newest summaries → ``performance.json``, tables             core, operator
======================  ==========================================================  =============

Nothing is imported here, so that a robot loads its calculators without the rest.
"""
