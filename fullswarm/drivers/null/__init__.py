"""The null make: ``null://<id>``, a robot that is nowhere. The smallest legal driver, and the template for new ones.

Further files:

``driver.py``  The smallest legal driver: integrates what it is told on a clock
"""
