"""Estimates of other robots and of obstacles.

``estimates.py``     The newest state of each neighbour, predicted to now; which robots are near each other
``obstacle_map.py``  Obstacles from the given map, from the robots' own sensors and from other robots
"""
