"""Names the processes of a secured swarm: who each is, by which certificate, and what its role lets it do.

Files:

``access.py``        who may publish and receive each key; the hub's access list made of it
``binding.py``       checks the names in a message against the name of its sender
``credentials.py``   roles, the files by which a process proves its name, the list of valid certificates
``private.py``       whether names are valid, and files private and whole
``folder.py``        where these files lie, and which certificates are valid
``certificates.py``  what a certificate states; keys and signing requests
``authority.py``     issues, renews, revokes and lists certificates
"""

from fullswarm.identity.credentials import ROLES, Credentials, Grant, Role, read_grants

__all__ = ["ROLES", "Credentials", "Grant", "Role", "read_grants"]
