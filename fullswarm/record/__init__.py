"""Recordings and views of a swarm: every message that an observer may receive, in MCAP files or in viewers; replay.

``recorder.py``    a node that writes what it receives, and the logs of the processes beside it
``recording.py``   one recording: channels, chunks that a kill cannot take back, new files by size
``scene.py``       what viewers draw, in Foxglove's schemas, made of the same messages
``lockstep.py``    records a swarm in lockstep
``replay.py``      runs the nodes of a recording again, and names the first difference
``table.py``       the newest of each robot in one message, for charts and tables
``viewer.py``      the same channels for viewers that connect: a Foxglove WebSocket
``live.py``        `viewer foxglove`: the process that serves it
``layout.py``      `viewer layout`: arena, charts, log and table for the robots of a fleet
``rerun_view.py``  `viewer rerun`: draws a live swarm or a recording in Rerun
``session.py``     `record start` and `record stop`: a recorder's process, and how others find it
``decoding.py``    recorded messages as they were on the bus
``playback.py``    `console --recording`: a recording through the console's nodes, for pages that look at it
``clip.py``        `record clip`: a part of a recording as a recording
``reading.py``     what a file holds, and the repair of one that was cut off
"""
