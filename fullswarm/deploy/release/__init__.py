"""Releases: all that a robot runs, in one signed directory that is the same bytes for the same input.

::

    <id>/ manifest.json    id, version, target (arch, glibc, python), extras, packages
          lib/             wheels of what the agent needs, unpacked and trimmed
          app/             fullswarm itself, and outside packages
          robot/           what stands on a robot outside every release (deploy/robot)
          SHA256SUMS       of every file but itself and its signature
          SHA256SUMS.sig   SSHSIG by the base's release key

``targets.py`` the computers · ``own.py`` ``outside.py`` what is wanted · ``uv.py`` ``wheels.py`` resolved for the
target and unpacked · ``trim.py`` ``layers.py`` what goes on board · ``bundle.py`` puts it together · ``sums.py``
``signing.py`` ``keys.py`` ``openssh.py`` make it trustworthy · ``store.py`` keeps releases side by side ·
``pack.py`` tar streams of parts. In flow wheels and code; out flows a folder, its files hard-linked to the release
before where they did not change.

Further files:

``manifest.py``  What a release says about itself: ``manifest.json``, the first file a robot reads
"""
