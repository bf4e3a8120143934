"""Makes a behaviour of a trained policy: a callable, or a file in the ONNX format.

    lab.request(policy(model.predict, spaces), goal=[5, 5])

In a package of its own the module of the control law consists of a few lines (its record: `PolicyLaw.record`):

    _law = policy(Path(__file__).with_name("net.onnx"), Spaces(neighbours=5))
    velocity, Memory = _law.velocity, _law.Memory

The policy sees and commands the robots at the same instants as in an environment: it is given what a robot observes
once per `Spaces.period_s`, and its action is in force from the next control period on, until the one after it. So a
policy has one control period of time for its answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import make_dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.envs.spaces import Observation, Spaces
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array, Flags
from fullswarm.memory import rows

Act = Callable[[Observation], object]
SLACK_S = 1e-6
"""Sums of periods differ by less from their multiples."""
ONE: Mapping[str, Any] = {
    "parameters": {"goal": {"type": "point", "unit": "m", "required": True, "doc": "where to, in the world frame"}}
}
EACH: Mapping[str, Any] = {
    "formation": "each",
    "parameters": {
        "targets": {"type": "points", "unit": "m", "doc": "one per robot, in the order of the request's robots"},
        "shape": {"type": "word", "choices": ["circle", "line", "grid"], "doc": "instead of targets"},
        "centre": {"type": "point", "unit": "m", "doc": "middle of the shape"},
        "spacing_m": {"type": "number", "unit": "m", "default": 1.0, "min": 0.1, "max": 100.0, "doc": "in the shape"},
    },
}
"""What a record says of the goals: one for all robots, or one for each."""


class Pilot(Protocol):
    """Decides for robots, by what they observe."""

    def observed(self, names: list[str], observation: Observation) -> None:
        """Take what robots observe now, (k, size)."""
        ...

    def decide(self, names: list[str], observation: Observation) -> object:
        """Return the actions (k, 2) for what robots observed one control period ago, (k, size)."""
        ...


class PolicyLaw:
    """A control law whose velocities a pilot decides; stands for the module of a law.

    Parameters
    ----------
    each : every robot has a goal of its own: the request gives ``targets``, or a ``shape``; else one ``goal``

    Attributes
    ----------
    twist, velocity : the law, one of them, as `spaces.action` says
    Memory : of each robot: the last action, the last observation, whether that is new, when the next one is due
    record : what its record must contain besides a summary and the name of the law
    """

    def __init__(self, pilot: Pilot, spaces: Spaces, name: str, *, each: bool = False) -> None:
        self.spaces, self.__name__ = spaces, name
        self._pilot, self._each = pilot, each
        self.Memory = make_dataclass(
            "Memory",
            [
                ("command", Array, rows(2)),
                ("observation", Array, rows(spaces.size)),
                ("new", Flags, rows(fill=False)),
                ("due_s", Array, rows()),
            ],
        )
        setattr(self, "twist" if spaces.action == "twist" else "velocity", self._law)

    @property
    def record(self) -> Mapping[str, Any]:
        """Neighbours are all robots in range; the goals are the request's."""
        goals = EACH if self._each else ONE
        return {"team": "swarm", "static": {"hearing_m": self.spaces.sensing_m, "coordination": False}, **goals}

    def _law(self, view: View, params: Params, memory: Any) -> Array:
        """Return the actions in force, (n, 2) in SI; ask for and take in new ones when they are due."""
        new, names = np.flatnonzero(memory.new), view.id
        if len(new):
            decided = self._pilot.decide(names[new].tolist(), memory.observation[new].astype(np.float32))
            memory.command[new] = self.spaces.velocities(decided, len(new))
        due = view.time_s >= memory.due_s - SLACK_S
        memory.new = due
        if due.any():
            period_s = self.spaces.period_s
            memory.due_s[due] = period_s * (np.floor((view.time_s[due] + SLACK_S) / period_s) + 1.0)
            observation = self.spaces.observe(view, params.target if self._each else params.goal)[due]
            memory.observation[due] = observation
            self._pilot.observed(names[due].tolist(), observation)
        command: Array = memory.command.copy()
        return command


class _Acting:
    """A pilot that calls a function."""

    def __init__(self, act: Act, *, batched: bool) -> None:
        self._act, self._batched = act, batched

    def observed(self, names: list[str], observation: Observation) -> None:
        """Do nothing."""

    def decide(self, _names: list[str], observation: Observation) -> object:
        """Return what the function returns."""
        if self._batched:
            return _first(self._act(observation))
        return np.array([_first(self._act(each)) for each in observation], float)


def _first(answer: object) -> object:
    """Return the actions alone; Stable-Baselines3's ``predict`` returns actions and a state."""
    return answer[0] if isinstance(answer, tuple) else answer


def policy(
    source: Act | Path | str, spaces: Spaces | None = None, *, batched: bool = True, each: bool = False
) -> PolicyLaw:
    """Return a trained policy as a behaviour: for ``Lab.request``, or as the control law of a package.

    Parameters
    ----------
    source : ``act(observations)`` that takes (k, size) float32 and returns (k, 2), or actions and something else; or
        the path of a file in the ONNX format whose first input and first output are those
    spaces : those that the policy was trained with, an environment's ``spaces``; None: the usual ones
    each : every robot has a goal of its own: ``request(policy(act, each=True), targets=[[5, 5], ...])``
    batched : False: ``act`` takes the observation (size,) of one robot and returns its action (2,)

    Raises
    ------
    ConfigError
        The file is missing, is no model, or does not fit the observation.
    MissingExtra
        onnxruntime is not installed.
    """
    spaces = spaces or Spaces()
    if isinstance(source, str | Path):
        path = Path(source)
        return PolicyLaw(_Acting(_model(path, spaces), batched=True), spaces, path.stem, each=each)
    if not callable(source):
        raise ConfigError(f"{source!r} is no policy", hint="a function act(observations), or the path of an .onnx file")
    name = str(getattr(source, "__name__", "policy")).strip("<>")
    return PolicyLaw(_Acting(source, batched=batched), spaces, name, each=each)


def _model(path: Path, spaces: Spaces) -> Act:
    """Return a function that evaluates a model."""
    if not path.is_file():
        raise ConfigError("no such file", where=str(path), hint="a model in the ONNX format")
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingExtra("a model needs onnxruntime", hint="pip install 'fullswarm[onnx]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same sums each time; such nets are small
    options.log_severity_level = 4  # what fails is raised
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of a native library, which raises many kinds
        raise ConfigError(f"is no ONNX model: {_line(error)}", where=str(path)) from error
    given, answer = session.get_inputs()[0], session.get_outputs()[0]
    if len(given.shape) != 2 or (isinstance(given.shape[1], int) and given.shape[1] != spaces.size):
        raise ConfigError(
            f"takes {given.shape}, and an observation has the shape (k, {spaces.size})", where=str(path),
            hint="give the Spaces that it was trained with",
        )  # fmt: skip
    one_by_one = isinstance(given.shape[0], int)  # exported for a batch of that size

    def act(observation: Observation) -> object:
        if not one_by_one:
            return session.run([answer.name], {given.name: observation})[0]
        found = [session.run([answer.name], {given.name: each[None]})[0] for each in observation]
        return np.concatenate(found)

    return act


def _line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
