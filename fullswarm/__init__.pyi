from fullswarm.lab import Lab as Lab
from fullswarm.operator.swarm import AsyncSwarm as AsyncSwarm
from fullswarm.operator.swarm import Swarm as Swarm

__version__: str
