"""A layer's local database on the bus (paper II.A): get, set with a check, history; every change is announced."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fullswarm.bus import Bus
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.keys import Keys
from fullswarm.messages import ParamChanged, ParamEntry, ParamReply, ParamRequest
from fullswarm.store import Store, Stored

Check = Callable[[str, object], Stored]


class ParamServer:
    """Answers ParamRequest for one layer.

    Parameters
    ----------
    checks
        Key → ``check(key, value)``, which returns the value to store or raises ``ConfigError``. A key that ends in
        ``*`` stands for all with its prefix. A key without a check cannot be set from outside.
    show
        Turns an entry into what a reader shall see.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        layer: str,
        store: Store,
        checks: Mapping[str, Check] | None = None,
        show: Callable[[ParamEntry], ParamEntry] = lambda entry: entry,
    ) -> None:
        self._bus, self._keys, self._layer, self._store = bus, keys, layer, store
        self._checks, self._show = dict(checks or {}), show
        self._done: dict[str, ParamReply] = {}  # a repeated set is answered, not done again
        self._unwatch = store.watch(self._announce)
        self._subscription = bus.subscribe(keys.param_request(layer), ParamRequest, self._answer)

    def close(self) -> None:
        """Answer no more."""
        self._subscription.close()
        self._unwatch()

    def _announce(self, entry: ParamEntry) -> None:
        self._bus.publish(self._keys.param_changed(self._layer), ParamChanged(layer=self._layer, entry=entry))

    def _answer(self, request: ParamRequest) -> None:
        reply = self._done.get(request.id)
        if reply is None:
            try:
                reply = ParamReply(id=request.id, ok=True, entries=self._serve(request))
            except FullswarmError as error:
                reply = ParamReply(id=request.id, ok=False, reason=str(error))
            if request.op == "set":
                self._done[request.id] = reply
                while len(self._done) > 1024:
                    del self._done[next(iter(self._done))]
        self._bus.publish(self._keys.param_reply(self._layer, request.id), reply)

    def _serve(self, request: ParamRequest) -> tuple[ParamEntry, ...]:
        key = request.key
        if request.op == "history":
            return self._store.history(key)
        if request.op == "set":
            return (self._set(key, request.value, request.author),)
        if key.endswith("*"):
            return tuple(map(self._show, self._store.list(key[:-1])))
        entry = self._store.entry(key)
        return () if entry is None or entry.value is None else (self._show(entry),)

    def _set(self, key: str, value: Stored, author: str) -> ParamEntry:
        check = self._checks.get(key)
        if check is None:
            wide = (found for name, found in self._checks.items() if name.endswith("*") and key.startswith(name[:-1]))
            check = next(wide, None)
        if check is None:
            raise ConfigError(f"'{key}' cannot be set", hint=did_you_mean(key, self._checks))
        return self._store.set(key, check(key, value), author or "unknown")
