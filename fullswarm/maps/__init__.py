"""Occupancy maps and scans as every layer needs them: cells as boxes, tiles and rays on the bus, files of ROS.

``boxes.py``    Covers the occupied cells of a grid with boxes
``ros_map.py``  Reads maps of ROS's map_server
``scans.py``    Packs scans of range sensors for the bus, as rays at equal angles
``tiles.py``    Cuts a grid of states into tiles and packs them for the bus
"""
