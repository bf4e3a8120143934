"""Estimates of other robots and of obstacles.

``estimates.py``     The newest state of each neighbour, predicted to now; which robots are near each other
``reception.py``     Whose states are received directly; states that the core relays instead
``obstacle_map.py``  Obstacles from the given map, from the robots' own sensors and from other robots
"""
