"""`fullswarm metrics`: serves the metrics of a live swarm by HTTP."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.openmetrics import exposition as openmetrics
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from fullswarm.exporter.families import SwarmCollector
from fullswarm.exporter.newest import SwarmNode
from fullswarm.launch.nodes import Node
from fullswarm.launch.observer import Address, Connection, serve
from fullswarm.operator.console.access import Guard, Names
from fullswarm.operator.session import Target
from fullswarm.output import data, data_json, progress

NAME = "metrics"
"""Of its certificate, where the hub is secured; its role is ``observer``, which can send nothing."""
CACHE_S, IDLE = 0.25, 4.0
"""A text is used again for this time, or `IDLE` times what it took to make: a flood of requests must not keep the
process busy."""
OPENMETRICS = "application/openmetrics-text"


class Metrics:
    """Answers requests for the metrics in Prometheus' text format, or in OpenMetrics where that is asked for."""

    def __init__(self, swarm: str, node: SwarmNode, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        self._registry.register(SwarmCollector(swarm, node))
        self._made: dict[bool, tuple[float, bytes]] = {}  # by whether it is OpenMetrics: until when, the text

    def app(self, names: Names) -> Starlette:
        """Return the ASGI application.

        Parameters
        ----------
        names : by which clients may call this server
        """
        routes = [Route("/metrics", self.answer), Route("/", self._page)]
        return Starlette(routes=routes, middleware=[Middleware(Guard, names=names)])

    async def answer(self, request: Request) -> Response:
        """Answer with the metrics."""
        wants = OPENMETRICS in request.headers.get("accept", "")
        kind = openmetrics.CONTENT_TYPE_LATEST if wants else CONTENT_TYPE_PLAIN_0_0_4
        return Response(self._text(wants), headers={"Content-Type": kind})

    def _text(self, as_openmetrics: bool) -> bytes:
        began_s = self._now_s()
        until_s, text = self._made.get(as_openmetrics, (0.0, b""))
        if not text or began_s >= until_s:
            text = _openmetrics(self._registry) if as_openmetrics else generate_latest(self._registry)
            ended_s = self._now_s()
            self._made[as_openmetrics] = ended_s + max(CACHE_S, IDLE * (ended_s - began_s)), text
        return text

    async def _page(self, _request: Request) -> Response:
        return PlainTextResponse("Metrics of a swarm: /metrics\n")


def _openmetrics(registry: CollectorRegistry) -> bytes:
    text: bytes = openmetrics.generate_latest(registry)  # type: ignore[no-untyped-call]  # the library has no types here
    return text


def run(target: Target, listen: str, allow_hosts: frozenset[str], gone_s: float, as_json: bool) -> int:
    """Serve the metrics until Ctrl-C; raises as `fullswarm.launch.observer.serve`. No hub need be there yet.

    Parameters
    ----------
    allow_hosts : names of this server in requests, in lower case, beside the address
    gone_s : what has been silent for so long is shown no more
    """

    def build(to: Connection) -> tuple[Starlette, list[Node]]:
        node = SwarmNode(to.bus, to.keys, to.runtime, gone_s)
        metrics = Metrics(target.swarm, node, to.runtime.now_s)
        return metrics.app(Names(to.address.host, to.address.port, allow_hosts)), [node]

    def on_start(address: Address) -> None:
        url = f"http://{address.shown}/metrics"
        if as_json:
            data_json({"url": url}, indent=None)
            return
        data(url)
        progress("let Prometheus scrape this; Ctrl-C ends")
        if not address.local:
            progress(f"every program that reaches {address.shown} can read the state of swarm '{target.swarm}'")

    return serve(target, NAME, listen, build, on_start, wait=False)
