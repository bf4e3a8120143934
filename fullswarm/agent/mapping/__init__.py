"""What a robot's range sensors show: obstacles for the safety filter, moving bodies, and an occupancy grid.

In: ``Reading.ranges``, poses, where the received robots are. Out: obstacles that are near, bodies that move, the map
of what was measured, shared with the other robots.

``sense.py``      Takes each scan once: points of the world, without the robots of the fleet
``grid.py``       The occupancy grid: log odds of each cell, from rays that end in it or pass through it
``clusters.py``   Groups of points that moved into free space, as discs
``sharing.py``    Sends the grid's tiles to the other robots and keeps theirs
"""
