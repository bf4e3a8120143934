"""`fullswarm mcp`: serves one swarm to a language model by the Model Context Protocol (extra ``[mcp]``).

In: calls of tools and reads of resources, from one client over stdin. Out: answers over stdout, and what
:class:`fullswarm.operator.swarm.Client` sends: requests, stops, e-stops, leases. A Python program reaches a swarm by
the same client, so the core checks what a model requests, and the audit log records it, as it does for people.

``server.py``     puts everything together: one process, one client, one swarm
``pipe.py``       the transport: lines over pipes, with bounds on size, rate and calls in flight
``limits.py``     bounds: a rate limit, and plain values of bounded size
``tools.py``      a tool: its arguments, its annotations, how its errors are answered
``access.py``     the connection to the swarm, and what of it several tools need
``reads.py``      tools that read
``authority.py``  the leases that the model has taken, and the tokens of its dry runs
``acts.py``       tools that stop robots, hold them, and request behaviours
``resources.py``  documents and schemas
"""
