"""Publishes external pose measurements as pose fixes: motion capture, GNSS receivers, radio anchors.

``fixes.py``             `fullswarm fixes`, and the sensors on board of a robot
``schemes.py``           which sources there are, by the scheme of their URL
``source.py``            the contract of a source; the node that turns what it delivers into fixes; the recorder
``links.py``             threads that keep a connection open
``sighting.py``          what a source has seen, and the conventions of senders; no I/O
``publisher.py``         sightings in; fixes, places of objects and the source's report out
``json_udp.py``          JSON datagrams
``natnet.py``            OptiTrack Motive
``vrpn.py``              VRPN trackers
``qualisys.py``          Qualisys Track Manager
``libmotioncapture.py``  Vicon and others through the package `motioncapture`
``libmotioncapture_worker.py``  its process
``gnss.py``              GNSS receivers: NMEA and UBX
``corrections.py``       RTK corrections for a receiver: where they come from, and the link
``ntrip.py``             NTRIP, the protocol of casters; no I/O
``rtcm.py``              RTCM 3 frames, and what waits to be sent to the receiver; no I/O
``uwb.py``               distances to radio anchors
``camera/``              `fullswarm track`: cameras that see tags on the robots
"""
