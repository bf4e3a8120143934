"""The estimated pose of each robot.

``estimator.py``    Poses of n robots from readings and fixes: direct, or by an extended Kalman filter
``pose_filter.py``  One robot's pose between odometry and fixes: dead reckoning, late fixes, outliers
``fixes.py``        External pose fixes: checked, dated and passed on
``conflicts.py``    Detects wrong poses: two robots in one place, a robot in a frame of its own
"""
