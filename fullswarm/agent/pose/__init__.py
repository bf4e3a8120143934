"""The estimated pose of each robot.

``estimator.py``    Poses of n robots from readings and fixes: direct, or by an extended Kalman filter
``pose_filter.py``  One robot's pose between odometry and fixes: dead reckoning, late fixes, outliers
``fixes.py``        External pose fixes: checked, dated and passed on
``sources.py``      What is known of the sources that see a robot, and what they do not see
``anchors.py``      Positions from distances to radio anchors
``map_poses.py``      Hands the places of robots on the known map on as fixes
``map_localizer.py``  One robot on a known map: a particle filter over ranges and odometry
``map_field.py``      How far each place of a map is from the nearest surface
``sources.py``        What is known of the sources that see one robot
``anchors.py``        Positions from distances to radio anchors of known place
``conflicts.py``    Detects wrong poses: two robots in one place, a robot in a frame of its own
"""
