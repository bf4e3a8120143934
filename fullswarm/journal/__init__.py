"""Journals: what the nodes of a process received and did, so that the same nodes can be run again on it.

``journal.py``   the items of a journal, their order, blocks of bytes; the file of a live process
``ports.py``     bus, scheduler, drivers and disk of a process whose use goes into its journal
``readings.py``  what drivers read, as bytes and back
``feed.py``      the same ports fed from a journal; compares what the nodes do with what they did
``naming.py``    the first difference between two messages or commands, in words
"""
