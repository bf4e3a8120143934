"""Recordings of a live swarm: every message that an observer may receive, in MCAP files.

``recorder.py``    a node that writes what it receives, and the logs of the processes beside it
``recording.py``   one recording: channels, chunks that a kill cannot take back, new files by size
``scene.py``       what viewers draw, in Foxglove's schemas, made of the same messages
``session.py``     `record start` and `record stop`: a recorder's process, and how others find it
``reading.py``     what a file holds, and the repair of one that was cut off
"""
