"""Makes releases: all that a robot runs, in one signed directory that has the same bytes for the same input.

::

    <id>/ manifest.json    id, version, target (arch, glibc, python), extras, packages
          lib/             wheels of what the agent needs, unpacked and trimmed
          app/             fullswarm itself, and outside packages
          robot/           what is on a robot outside every release (deploy/robot)
          SHA256SUMS       of every file but itself and what is signed
          SHA256SUMS.sig   SSHSIG by the base's release key, for robots with older tools
          STATEMENT        number, expiry and the digest of SHA256SUMS, with their signature

``bundle.py``    makes a release of the parts below
``targets.py``   the computers that releases are made for: a new release target is a line here (for another
                 processor also in ``TARGET_OF`` of ``deploy/fleet/releases.py``)
``packages.py``  which Python packages are installed on board, in which versions, and their files for the target
``contents.py``  which files of fullswarm and of its wheels are installed on board
``manifest.py``  ``manifest.json`` and ``SHA256SUMS``
``keys.py``      the keys of a base station and the root metadata; signs and verifies releases
``trust.py``     what robots trust: root metadata, and statements about releases and support packages
``signatures.py``  SSHSIG by ``ssh-keygen``, with a passphrase, an agent or a FIDO security key
``store.py``     releases side by side, and tar streams of parts of one

In: wheels and code. Out: a folder, its files hard-linked to the previous release where they did not change.
"""
