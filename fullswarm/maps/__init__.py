"""Occupancy maps as every layer needs them: cells as boxes, tiles on the bus, files of ROS's map_server.

``boxes.py``    Covers the occupied cells of a grid with boxes
``ros_map.py``  Reads maps of ROS's map_server
``tiles.py``    Cuts a grid of states into tiles and packs them for the bus
"""
