"""What an agent publishes about its robots.

``reports.py``        States and health
``metrics.py``        What robots measure of themselves
``waiting.py``        Which silent robots a robot that stands waits for
``interventions.py``  What the safety filter changes, in which direction, and because of what
``remembered.py``     What control laws remember, for recordings and operators
``actuated.py``       What was asked of the robots' actuators, for operators
``scans.py``          The newest scans of range sensors, while there is a query for them
``health_file.py``    The result of the health check of a new release, as a file
"""
