"""The console's interface for outside programs: REST and a WebSocket below ``/api/v1``, switched on by ``--api``.

In, from a program: HTTP requests and frames of a WebSocket, each with the token of a named operator. Out: answers in
JSON, errors as RFC 9457 has them, and on the bus what an operator of the page sends. Decision 80 has the reasons.

``routes.py``    the table of all operations: read this first
``records.py``   what operations receive and return; the OpenAPI document is made of it
``reads.py``     operations that read
``acts.py``      operations that change something: leases, requests, twists, stops, e-stops
``programs.py``  what one program holds and has requested; a node without asyncio
``twists.py``    robots that a program drives by twists, each with a time to live
``access.py``    who calls: token, role, rate; what a body may be
``problems.py``  errors as ``application/problem+json``
``stream.py``    the WebSocket: states at a rate, twists
``openapi.py``   the OpenAPI document and the page that lists the operations
``server.py``    the application that answers below ``/api/v1``
"""
