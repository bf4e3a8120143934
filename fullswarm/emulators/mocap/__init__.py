"""Players of motion capture systems and receivers: they speak a vendor's format on a real port.

They share no code with :mod:`fullswarm.localization`, whose parsers they test: each layout was written from the
vendor's published description, named in its file.

``server.py``    what a player shows, and the thread that runs it
``natnet.py``    OptiTrack Motive, NatNet 2.6 to 4.2
``vrpn.py``      VRPN trackers
``qualisys.py``  Qualisys Track Manager, RT protocol
``vicon.py``     Vicon DataStream
``raw.py``       bytes as they were recorded, over TCP: GNSS receivers, radio tags; JSON over UDP
``player.py``    `fullswarm fixes play`: a recording on a real port
"""
