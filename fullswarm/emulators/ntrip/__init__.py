"""An emulated NTRIP caster on a TCP port, which shares no code with :mod:`fullswarm.localization`.

- ``caster.py``: the caster, and what can go wrong with one
"""
