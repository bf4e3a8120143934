"""Writes the page of `fullswarm guide`: how to use and extend fullswarm, with the facts that the code has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import fullswarm
from fullswarm import errors, output, registry

FIRST = (
    ("demo", "fullswarm demo"),
    ("init", "fullswarm init my-lab"),
    ("up", "fullswarm up my-lab/lab.toml"),
    ("status", "fullswarm status"),
    ("behaviours", "fullswarm behaviours move_to_goal_bc"),
    ("request", "fullswarm request move_to_goal_bc --robots r1 --set goal=5,5"),
    ("stop", "fullswarm stop"),
    ("estop", "fullswarm estop"),
    ("experiment run", "fullswarm experiment run paper --small --out results/paper"),
    ("results report", "fullswarm results report results/paper"),
)
"""The ten commands to begin with: the command, and an example of it."""

DOCUMENTS = (
    ("docs/tutorial-first-swarm.md", "from nothing to a swarm that moves"),
    ("docs/reference-cli.md", "all commands and options"),
    ("docs/reference-messages.md", "all messages and keys"),
    ("docs/behaviours.md", "all behaviours with pictures"),
    ("docs/how-to-add-a-behaviour.md", "a control law, its record, its test"),
    ("docs/how-to-add-a-driver.md", "a robot of another make"),
    ("docs/how-to-run-an-experiment.md", "measure, compare, report"),
    ("docs/how-to-use-from-python.md", "Lab, Swarm and AsyncSwarm"),
    ("docs/how-to-language-models.md", "MCP: a language model reads the swarm, or moves robots"),
    ("docs/how-to-run-a-mission.md", "behaviours one after another, with conditions"),
    ("docs/how-to-connect-a-robot.md", "from a cable to a fleet file"),
    ("docs/how-to-deploy-and-update.md", "releases on robots"),
    ("docs/explanation-safety-stops.md", "what stops a robot, and when"),
    ("docs/explanation-safety-filter.md", "what the safety filter guarantees, and what it does not"),
    ("CONTRIBUTING.md", "the rules of the code"),
)
EXAMPLES = ("examples/outside_driver", "examples/outside_behaviour", "examples/behaviours")
CHECKOUT = Path(fullswarm.__file__).parents[1]
OTHER = "Operate"
"""The commands without a heading of their own in `fullswarm --help`."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command: its words after ``fullswarm``, what it does, its heading in the help, its options."""

    words: tuple[str, ...]
    text: str
    panel: str
    options: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its words as one text."""
        return " ".join(self.words)


def page(commands: Sequence[Command]) -> str:
    """Return the page as Markdown."""
    sections: Iterable[tuple[str, Iterable[str]]] = (
        ("Ten commands to begin with", _first(commands)),
        ("Safety", SAFETY),
        ("Write a behaviour", BEHAVIOUR),
        ("Connect a robot, write a driver", _drivers()),
        ("Measure", EXPERIMENT),
        ("From Python", PYTHON),
        ("With a language model", MODEL),
        ("Behaviours", _behaviours()),
        ("All commands", _commands(commands)),
        ("Exit codes", _exit_codes()),
        ("Extras", _extras()),
        ("Documents", _documents()),
    )
    lines = [f"# fullswarm {fullswarm.__version__}", "", *ABOUT]
    for title, body in sections:
        lines += ["", f"## {title}", "", *body]
    return "\n".join(lines)


ABOUT = (
    "fullswarm runs swarm behaviours on ground robots of different makes. A behaviour is written once and requested by",
    "name; the same code drives simulated robots, emulated hardware and real robots, and measures how well they did.",
    "It consists of plain Python processes on one message bus: `hub` carries messages, `core` decides which robot runs",
    "what, one `agent` per robot runs the control law, the safety filter and the robot's driver.",
)
SAFETY = (
    "- `fullswarm estop` latches the e-stop of all robots, at once; only `fullswarm estop --clear` releases it, by a",
    "  person who has seen that the surroundings are free. `fullswarm stop` stops without a latch.",
    "- Request behaviours with `_bc` at the end of their name: they run behind the safety filter. It does not detect",
    "  people or anything else that is not in the swarm, on the map, or measured by range sensors.",
    "- Try everything on simulated robots first (`driver` left out in the fleet file). With a real robot: its own",
    "  switch within reach, `fullswarm doctor`, `fullswarm robots test`.",
    "- A robot stops by itself when its hub, its core, its sensors or its agent fails; never work around that.",
    "- A latched e-stop, a refusal (exit code 2) or a safety stop (exit code 4) is an answer: report it, do not repeat",
    "  the command until it works.",
)
BEHAVIOUR = (
    "    fullswarm behaviours new orbit              # the law, its record, its test, in this package",
    "    pip install -e '.[test]'                    # the behaviour is known on this computer",
    "    pytest                                      # runs the test in lockstep, without a robot",
    "    fullswarm behaviours picture orbit_bc       # draws it on simulated robots",
    "    fullswarm up lab.toml --reload --console    # loads it again when it is saved",
    "    fullswarm request orbit_bc",
    "",
    "A control law is `velocity(view, params)`: from what a robot knows of itself and its neighbours to a velocity in",
    "m/s, (n, 2), in the world frame. It has no I/O, no clock, no randomness of its own. Its record (TOML) names its",
    "parameters with type, unit, limits and default. `fullswarm.testing` has the checks that its test calls.",
)
EXPERIMENT = (
    "    fullswarm experiment run paper --small --out results/paper",
    "    fullswarm results list results/paper",
    "    fullswarm results report results/paper",
    "",
    "An experiment is a TOML file: behaviours, scenarios, numbers of robots, seeds. Trials are repeatable to the byte",
    "for a seed. `--live` runs them through real processes.",
)
PYTHON = (
    "    from fullswarm import Lab",
    "    lab = Lab(robots=8, bounds=(0, 0, 8, 8), seed=7)",
    '    lab.request("rendezvous_bc")',
    "    lab.run(15)",
    "",
    "`from fullswarm import Swarm` is a live swarm, `AsyncSwarm` the same with asyncio.",
)
MODEL = (
    "    fullswarm mcp                       # reads the swarm and may stop robots; a client starts it",
    "    fullswarm mcp --allow-requests      # may hold robots and request behaviours behind the safety filter as well",
)


def _first(commands: Sequence[Command]) -> Iterator[str]:
    texts = {each.name: each.text for each in commands}
    for name, example in FIRST:
        yield f"- `{example}`: {_small(texts[name])}"


def _small(text: str) -> str:
    return text[:1].lower() + text[1:]


def _drivers() -> Iterator[str]:
    yield "    fullswarm robots find                       # asks every port which robot is there"
    yield "    fullswarm robots test URL                   # drives one robot a little"
    yield "    fullswarm robots check URL                  # the published check of drivers"
    yield ""
    yield f"Schemes of URLs: {', '.join(f'`{scheme}://`' for scheme in registry.DRIVERS)}."
    yield f"A driver of your own is a package with an entry point in the group `{registry.DRIVER_GROUP}`; laws have"
    yield f"`{registry.BEHAVIOUR_GROUP}` and `{registry.CENTRALISED_GROUP}`. Complete in the checkout:"
    yield f"{', '.join(f'`{each}`' for each in EXAMPLES)}."


def _behaviours() -> Iterator[str]:
    from fullswarm.core.behaviours import all_records, make_record

    tables = all_records()
    records = {name: make_record(name, tables) for name in tables}
    yield "With `_bc` at its end a name means the same behind the safety filter."
    yield ""
    for name, record in sorted(records.items()):
        if name.endswith("_bc") and name.removesuffix("_bc") in records:
            continue
        filtered = ", also `_bc`" if f"{name}_bc" in records else ""
        parameters = ", ".join(
            f"{each}{' (required)' if spec.required else ''}" for each, spec in record.parameters.items()
        )
        yield f"- `{name}`{filtered}: {record.summary}" + (f". Parameters: {parameters}" if parameters else "")


def _commands(commands: Sequence[Command]) -> Iterator[str]:
    yield "`fullswarm COMMAND --help` lists the options of each."
    for panel in dict.fromkeys(each.panel for each in commands if len(each.words) == 1):
        yield f"\n### {panel or OTHER}\n"
        top = {each.words[0] for each in commands if len(each.words) == 1 and each.panel == panel}
        yield from (f"- `fullswarm {each.name}`: {each.text}" for each in commands if each.words[0] in top)


def _exit_codes() -> Iterator[str]:
    yield "- 0: done"
    by_code: dict[int, list[str]] = {}
    for line in (errors.__doc__ or "").splitlines():
        name, _, code = line.strip("│├└─ ").rpartition(" exit ")
        if code.strip().isdigit():
            by_code.setdefault(int(code), []).append(" ".join(name.split()[1:]))
    by_code.setdefault(1, []).insert(0, "finished, but with a negative result")
    for number, meanings in sorted(by_code.items()):
        yield f"- {number}: {'; '.join(meanings)}"
    yield f"- {output.BUG}: a bug in fullswarm; `--debug` shows where"
    yield f"- {output.INTERRUPTED}: interrupted (Ctrl-C)"


def _extras() -> Iterator[str]:
    from fullswarm.bringup.info import requirements

    _, extras = requirements()
    yield "`pip install 'fullswarm[NAME]'`; on this computer:"
    yield ""
    yield from (f"- `{name}`: {state}" for name, state in sorted(extras.items()) if name not in ("(base)", "?"))


def _documents() -> Iterator[str]:
    here = (CHECKOUT / "docs").is_dir()
    yield "In the source checkout of fullswarm" + (f", `{CHECKOUT}`:" if here else " (not on this computer):")
    yield ""
    yield from (f"- `{path}`: {about}" for path, about in DOCUMENTS)
