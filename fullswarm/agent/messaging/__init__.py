"""Messages between the robots that run a behaviour, and their shared table.

``throttle.py``  limits how often each sender's broadcasts are taken in
``table.py``     a shared key-value table, one replica per robot, which converges
"""
