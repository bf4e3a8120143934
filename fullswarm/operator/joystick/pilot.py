"""Converts the inputs of gamepads to requests, stops and e-stops.

The rules: nothing moves without the dead-man; releasing it sends zero at once; after any problem (unplugged, taken
over, refused, no core) it must be released and pressed again. Stop and e-stop need neither dead-man nor lease.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import Interventions
from fullswarm.operator.client import Operator
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.joystick.bindings import Bindings, Directions, Stick
from fullswarm.operator.joystick.selection import Chooser, Roster
from fullswarm.operator.joystick.state import PadSource, PadState
from fullswarm.operator.joystick.teleop_session import TeleopSession
from fullswarm.operator.params import ParamClient
from fullswarm.runtime import Scheduler, Timer

POLL_S = 0.005
HELD_POLL_S = 0.002
"""While driving: a sample costs 40 µs, and waiting for it is most of the latency from stick to wheels."""
IDLE_POLL_S = 0.1
RUMBLE_S = 0.3
"""The least time between pulses: the filter's interventions shall not become a continuous buzz."""
ESTOP_PATIENCE_S = 60.0
DIGITS = 4


@dataclass(frozen=True, slots=True)
class PilotStatus:
    """What the screen shows."""

    pad: str  # empty: none
    selection: str
    robots: int
    dead_man: bool
    behaviour: str  # empty: nothing is streamed
    values: Mapping[str, float] = field(default_factory=dict)
    turbo: bool = False
    note: str = ""


class Pilot:
    """Reads pads and drives robots.

    Parameters
    ----------
    pad
        The only pad that may drive: its number, from 1, or its GUID; empty: the one whose dead-man is pressed.
    only
        Robots to choose among; none: all.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        operator: Operator,
        source: PadSource,
        bindings: Bindings,
        *,
        pad: str = "",
        only: Iterable[str] = (),
    ) -> None:
        self._scheduler, self._operator, self._source, self._bindings = scheduler, operator, source, bindings
        self._pad = pad
        params = ParamClient(bus, keys, scheduler, operator.name)
        self._roster = Roster(bus, keys, scheduler, params, only, self._roster_changed)
        self._chooser = Chooser(self._roster)
        self._session = TeleopSession(
            bus, keys, scheduler, operator, self._roster, on_lost=self._refuse, on_note=self._show_note
        )
        self._subscription = bus.subscribe(keys.intervention(), Interventions, self._on_interventions)
        self._pads: dict[int, PadState] = {}
        self._numbers: dict[int, int] = {}  # each pad keeps its own while it is plugged in
        self._current: int | None = None
        self._stick: Directions | Stick | None = None
        self._await_centre = False
        self._estop: EStopOrder | None = None
        self._rumbled_s = -RUMBLE_S
        self._note = ""
        self._timer: Timer | None = None
        self._period_s = 0.0

    # ------------------------------------------------------------------ start and end
    def start(self) -> None:
        """Start polling."""
        self._poll()

    def close(self, on_done: Callable[[], None]) -> None:
        """Send zero, release the robots, then call `on_done`."""
        if self._timer is not None:
            self._timer.cancel()

        def end() -> None:
            self._session.close()
            self._roster.close()
            self._subscription.close()
            on_done()

        self._session.release(end)

    def status(self) -> PilotStatus:
        """Return the status to show."""
        selection = self._session.selection or self._chooser.now()
        shown = self._pads.get(self._current) if self._current is not None else next(iter(self._pads.values()), None)
        buttons, held = self._bindings.buttons, shown.buttons if shown is not None else frozenset()
        return PilotStatus(
            pad="" if shown is None else shown.name,
            selection=selection.label,
            robots=len(selection.robots),
            dead_man=buttons.dead_man in held,
            behaviour=self._session.behaviour,
            values=self._session.values,
            turbo=buttons.turbo in held,
            note=self._estop_note() or self._note,
        )

    def _poll(self) -> None:
        try:
            states = self._source.poll()
        except Exception as error:  # any error of a pad's driver stops its robots: as if it were unplugged
            states = ()
            self.tick(states)
            self._show_note(f"gamepads cannot be read: {error}")
        else:
            try:
                self.tick(states)
            except Exception:
                self._session.release()
                raise
        held = self._session.selection is not None
        period_s = IDLE_POLL_S if not states else HELD_POLL_S if held else POLL_S
        if period_s != self._period_s:
            if self._timer is not None:
                self._timer.cancel()
            self._period_s = period_s
            self._timer = self._scheduler.every(period_s, self._poll)

    # ------------------------------------------------------------------ one sample
    def tick(self, states: tuple[PadState, ...]) -> None:
        """Process the inputs of all pads."""
        before, self._pads = self._pads, {state.id: state for state in states}
        for gone in before.keys() - self._pads.keys():
            del self._numbers[gone]
            self._unplugged(before[gone])
        for state in states:
            if state.id not in before:
                self._plugged(state)
        edges = {s.id: s.buttons - (before[s.id].buttons if s.id in before else frozenset()) for s in states}
        self._emergencies(frozenset().union(*edges.values()))
        self._session.check()
        for state in states:
            if self._may(state):
                # A dead-man that is down when its pad is plugged in, or taped, has not been pressed.
                self._dead_man(state, edges[state.id] if state.id in before else frozenset())
        leader = self._leader(states)
        if leader is not None:
            self._choose(edges[leader.id])
            if leader.id == self._current and self._bindings.buttons.dead_man in leader.buttons:
                self._held(leader, edges[leader.id])

    def _leader(self, states: tuple[PadState, ...]) -> PadState | None:
        """Return the pad whose buttons count: the one that drives or drove last, else the first that may."""
        if self._current is not None:
            return self._pads[self._current]
        return next((each for each in states if each.known and self._may(each)), None)

    def _may(self, state: PadState) -> bool:
        return self._pad in ("", str(self._numbers[state.id]), state.guid)

    def _plugged(self, state: PadState) -> None:
        taken = self._numbers.values()
        self._numbers[state.id] = next(number for number in count(1) if number not in taken)
        what = "plugged in" if state.known else "is unknown to SDL: map it with `fullswarm joystick map`"
        self._show_note(f"{state.name} {what}")

    def _unplugged(self, state: PadState) -> None:
        self._show_note(f"{state.name} is gone")
        if state.id != self._current:
            return
        self._current = None
        selection, drove = self._session.selection, bool(self._session.behaviour)
        self._session.release()
        if selection is not None and drove:
            self._operator.stop(selection.addressed)
            self._show_note(f"{state.name} is gone: {selection.label} stopped")

    def _emergencies(self, pressed: frozenset[str]) -> None:
        buttons = self._bindings.buttons
        if buttons.estop in pressed:
            self._session.release()
            if self._estop is not None:
                self._estop.close()  # each press is an order of its own: another operator may have cleared the last one
            self._estop = self._operator.estop(
                True, (), "gamepad", known=self._roster.all_robots, deadline_s=ESTOP_PATIENCE_S
            )
        elif buttons.stop in pressed:
            selection = self._session.selection or self._chooser.now()
            self._session.release()
            self._operator.stop(selection.addressed)
            self._show_note(f"stop: {selection.label}")

    def _dead_man(self, state: PadState, pressed: frozenset[str]) -> None:
        dead_man = self._bindings.buttons.dead_man
        if dead_man not in state.buttons:
            if state.id == self._current and self._session.selection is not None:
                self._session.release()
        elif dead_man in pressed and (self._session.selection is None or state.id == self._current):
            self._current = state.id
            self._take_up()

    def _take_up(self, *, take: bool = False) -> None:
        self._await_centre, self._stick, self._note = False, None, ""
        problem = self._session.take_up(self._chooser.now(), take=take)
        if problem:
            button = self._bindings.buttons.take
            held = bool(self._session.holders(self._chooser.now()))
            taken = f" ({button} with the dead-man takes over)" if button and held else ""
            self._refuse(problem + taken)

    def _choose(self, pressed: frozenset[str]) -> None:
        buttons = self._bindings.buttons
        before = self._chooser.now()
        for button, choose, step in (
            (buttons.next_robot, self._chooser.step_robot, 1),
            (buttons.previous_robot, self._chooser.step_robot, -1),
            (buttons.next_group, self._chooser.step_group, 1),
            (buttons.previous_group, self._chooser.step_group, -1),
        ):
            if button in pressed:
                choose(step)
        if self._chooser.now() != before and self._session.selection is not None:
            self._session.release()
            self._take_up()
            self._await_centre = True  # a stick that is pushed for the old selection must not start the new one

    # ------------------------------------------------------------------ while the dead-man is held
    def _held(self, state: PadState, pressed: frozenset[str]) -> None:
        others = self._session.selection is None and self._session.holders(self._chooser.now())
        if others and self._bindings.buttons.take in pressed:
            self._take_up(take=True)
            self._await_centre = True
        if not self._session.ready:
            return
        for button, order in self._bindings.requests.items():
            if button in pressed:
                self._session.request(order.behaviour, order.parameters)
                self._await_centre = True
        self._drive(state)

    def _drive(self, state: PadState) -> None:
        bindings = self._bindings
        offsets = {id(stick): bindings.offsets(state, stick) for stick in bindings.all_sticks}
        off_centre = [stick for stick in bindings.all_sticks if any(offsets[id(stick)])]
        if not off_centre:
            self._await_centre = False
        stick = self._stick if self._stick in off_centre else next(iter(off_centre), None)
        selection = self._session.selection
        if stick is None or self._await_centre or selection is None:
            self._session.centre()
            return
        if stick.one_robot and len(selection.robots) != 1:
            self._session.centre()
            self._show_note(f"that stick drives one robot, not {selection.label}: choose one (next robot)")
            return
        self._stick = stick
        share = 1.0 if bindings.buttons.turbo in state.buttons else bindings.motion.share_without_turbo
        behaviour, values = stick.read(offsets[id(stick)], self._session.behaviour)
        shares = {name: round(value * share, DIGITS) for name, value in values.items()}
        self._session.hold(behaviour, shares, stick.parameters)

    # ------------------------------------------------------------------ feedback
    def _refuse(self, why: str) -> None:
        """Show why robots are not driven, and rumble."""
        self._show_note(why)
        if self._current is not None:
            self._source.rumble(self._current, 0.8, 0.25)

    def _show_note(self, note: str) -> None:
        self._note = note

    def _estop_note(self) -> str:
        order = self._estop
        if order is None:
            return ""
        late, all_of_them = order.unconfirmed(), order.concerned()
        text = f"E-STOP: {len(all_of_them) - len(late)} of {len(all_of_them)} confirmed at standstill"
        return f"{text}; not {', '.join(late)}" if late else text

    def _roster_changed(self) -> None:
        selection = self._chooser.now()
        if self._session.selection is not None and selection.label == self._session.selection.label:
            self._session.follow(selection)

    def _on_interventions(self, message: Interventions) -> None:
        selection, now_s = self._session.selection, self._scheduler.now_s()
        if selection is None or self._current is None or not self._session.driving:
            return
        theirs = [at for at, robot in enumerate(message.robots) if robot in selection.robots]
        if not theirs:
            return
        reasons = [message.reasons[at] for at in theirs if at < len(message.reasons)]
        self._show_note(f"filter: {message.robots[theirs[0]]}: {reasons[0] if reasons else 'held back'}")
        if now_s - self._rumbled_s >= RUMBLE_S:
            self._rumbled_s = now_s
            self._source.rumble(self._current, 0.3, 0.15)
