"""Plans ways on a map of rounded boxes, exactly, and coordinates robots in narrow passages.

``geometry.py``      exact distances between points, straight ways and rounded boxes
``passages.py``      the passages of a map: gaps between two obstacles
``roadmap.py``       the graph of ways on a map, and the shortest ways to a goal
``route.py``         the point that a robot drives to next, and the next passage on its way
``right_of_way.py``  who drives through a narrow passage, and where the others wait
``edges.py``         keeps robots off the edge of the arena
``planner.py``       keeps roadmaps and fields, leads them around robots that stand, and says why there is no way
"""
