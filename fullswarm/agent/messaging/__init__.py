"""Messages between the robots that run a behaviour, and their shared table.

A control law broadcasts with ``view.say`` what its class ``Says`` declares, reads the neighbours' with ``view.heard``,
and shares keys and values with all robots of the request by ``view.table``. Nothing here affects the safety filter, the
reflexes or the stops.

``exchange.py``     sends and takes in broadcasts, keeps the tables in step
``declaration.py``  what a control law declares to broadcast
``received.py``     the newest broadcast of each sender, and ``view.heard``
``throttle.py``     limits how often each sender's broadcasts are taken in
``table.py``        a shared key-value table, one replica per robot, which converges
"""
