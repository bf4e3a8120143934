"""The Acme Scout, a small delivery robot that does not exist, as a package outside of fullswarm.

``protocol`` is bytes only and pure; ``session`` is the conversation without port, thread or clock; ``driver`` owns the
TCP connection and its thread; ``emulator`` is the other end of the wire, over a body that really moves.
"""
