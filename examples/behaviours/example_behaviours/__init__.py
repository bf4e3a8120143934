"""Behaviours of at most 40 lines each, law and record together.

``auction.py``            shares out tasks by bids in the shared table
``average.py``            agrees on a mean by broadcasts, whatever is lost
``follow_the_leader.py``  drives each robot behind the one before it
``forage.py``             searches and carries, a state machine per robot
``pursue_next.py``        has each robot pursue the next one
``waypoints.py``          follows waypoints by PID
"""
