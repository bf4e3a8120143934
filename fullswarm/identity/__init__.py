"""Names the processes of a secured swarm: who each is, by which certificate, and what its role lets it do.

Files:

``credentials.py``  roles, the files by which a process proves its name, the list of valid certificates
"""

from fullswarm.identity.credentials import ROLES, Credentials, Grant, Role, read_grants

__all__ = ["ROLES", "Credentials", "Grant", "Role", "read_grants"]
