"""What an agent publishes about its robots.

``reports.py``        States and health
``metrics.py``        What robots measure of themselves
``interventions.py``  What the safety filter changes, in which direction, and because of what
``health_file.py``    Whether a new release works on this robot, as a file
"""
