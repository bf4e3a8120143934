"""Behaviours of at most 40 lines each, law and record together.

``auction.py``  shares out tasks by bids in the shared table
``average.py``  agrees on a mean by broadcasts, whatever is lost
"""
