"""Sees robots by tags on their tops with cameras above them: `fullswarm track`.

    pictures ──▶ finder ──▶ tracker (with mounting) ──▶ node ──▶ pose fixes

``plan.py``            which tag is on which robot, where tags lie on the floor
``optics.py``          pixels to places and back; OpenCV
``finder.py``          finds tags in pictures
``mounting.py``        notices a moved camera by the floor tags, and finds its new pose
``tracker.py``         poses of robots, with covariance; what is refused and why
``sources.py``         devices, streams, videos, folders of pictures
``node.py``            one camera in a swarm
``overlay.py``         draws what was found
``floor_mesh.py``      where the picture lies on the floor
``preview.py``         the live picture over HTTP
``board.py``           the calibration board
``calibrate.py``       lens and place of a camera
``camera_file.py``     the file of a calibration
``sheets.py``          prints the tags and the board
``rehearsal.py``       the simulated camera, `world://`
``fleet_template.py``  a fleet file to begin with
``run.py``             what the commands do
"""
