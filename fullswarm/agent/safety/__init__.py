"""The safety filter: the smallest change to a desired velocity that keeps robots and obstacles apart.

Files:

``barrier.py``   Barrier certificates for unicycles, per robot (paper III.A, its [11]: Wang, Ames, Egerstedt 2017)
``braking.py``   Speed and turn rate that can still be brought to zero before a gap is used up
``dead_time.py`` Commands that are given but have no effect yet, and what they will still do
``deadlock.py``  Robots that block each other: detected while they run, and guided around each other
``filter.py``    The filter of n robots from tick to tick: its output, the deviation, why it brakes
``stalls.py``    How long the control loop may hang: the robot drives on meanwhile
``startup.py``   Whether robots sense each other early enough to stop, before a start
"""
