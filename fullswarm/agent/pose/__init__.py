"""The estimated pose of each robot.

``estimator.py``    Poses of n robots from readings and fixes: direct, or by an extended Kalman filter
``pose_filter.py``  One robot's pose between odometry and fixes: dead reckoning, late fixes, outliers
``fixes.py``        Pose fixes from outside: checked, dated and passed on
``conflicts.py``    Poses that cannot be right: two robots in one place, a frame of its own
"""
