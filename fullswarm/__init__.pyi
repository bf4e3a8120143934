from fullswarm.lab import Lab as Lab

__version__: str
