"""Recordings of a swarm in MCAP files: every message that an observer may receive; journals, and their replay.

``recorder.py``    a node that writes what it receives, and the logs of the processes beside it
``recording.py``   one recording: channels, chunks that a kill cannot take back, new files by size
``scene.py``       what viewers draw, in Foxglove's schemas, made of the same messages
``lockstep.py``    records a swarm in lockstep
``replay.py``      runs the nodes of a recording again, and names the first difference
``session.py``     `record start` and `record stop`: a recorder's process, and how others find it
``reading.py``     what a file holds, and the repair of one that was cut off
"""
