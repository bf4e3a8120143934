"""The swarm as ROS sees it: topics of ROS 1 and ROS 2 made of the bus, and commands of ROS for a named operator.

::

    session.py              `fullswarm ros bridge`: connects both sides and serves until Ctrl-C
      bridge.py             the node: receives from the bus, publishes to ROS; read this first
        values.py           states, health, obstacles and grids as plain values of ROS messages
        grid.py             the tiles of all hosts joined in one occupancy grid
        cmd_vel.py          drives robots by the velocities that ROS publishes: leases, dead-man, refusals
        scans.py              the scans of one robot's range sensors
        requests.py         carries out requests in JSON, and answers them
        control_requests.py   shows which behaviour each robot runs, on the paper's topics
        complaints.py       counts and names what ROS sends wrongly, without a flood in the log
      link.py               what the node needs of a side of ROS: topics, messages
      codec.py              plain values ↔ bytes of ROS 1 and ROS 2, by the rosbags library
      zenoh_link.py         ROS 2: a zenoh session of its own, in the keys of rmw_zenoh or of zenoh-bridge-ros2dds
      ros1_link.py          ROS 1: the other end of a pipe to a process with rospy
        ros1_process.py     that process; runs with the system's Python, not with ours

Extra: ``pip install 'fullswarm[ros-bridge]'``. Nothing of ROS comes onto the swarm's bus: the sides share no session.
"""
