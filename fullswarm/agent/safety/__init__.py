"""The safety filter: the smallest change to a desired velocity that keeps robots and obstacles apart.

Files:

``barrier.py``   Barrier certificates for unicycles, per robot (paper III.A, its [11]: Wang, Ames, Egerstedt 2017)
``braking.py``   Speed and turn rate that can still be brought to zero before a gap is used up
``deadlock.py``  Robots that block each other: detected while they run, and led around each other
``filter.py``    The filter of n robots from tick to tick: what it lets through, how much it changes, why it brakes
"""
