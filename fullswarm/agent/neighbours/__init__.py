"""Estimates of other robots and of obstacles.

``estimates.py``     The newest state of each neighbour, predicted to now; which robots are near each other
``profiles.py``      What the robots are and can do: makes, capabilities, limits, charges; sent seldom
``reception.py``     Whose states are received directly; states that the core relays instead
``standing.py``      Robots at standstill that are not on their way, as obstacles
``objects.py``       What moves and is no robot that is received: people, carts, silent robots in sight
``silent.py``        Where silent robots may still be: the part of their discs that was not seen empty
``obstacle_map.py``  Obstacles from the given map, from the robots' own sensors and from other robots
"""
