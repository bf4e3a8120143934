"""Learns from a robot's reports what it draws at work, on the way to a dock, and how fast a dock charges it."""

from __future__ import annotations

from dataclasses import dataclass

WINDOW_S = 60.0
"""A rate is measured over so long: a reported charge has steps, of a Create of 0.04 % of its capacity."""
SHARE = 0.2
"""Of a new measurement in what is known."""
WAY_FALLS = 0.1
"""A way that took more than expected counts at once, one that took less by this share: a robot must get there."""
DOCKING_S = 60.0
"""A way is taken to last so long beyond its length: turning, waiting for others, the last metre."""


@dataclass(slots=True)
class Energy:
    """What is known of one robot; charges are shares of a full battery.

    Attributes
    ----------
    draw_per_s : at work
    way_per_m : on the way to a dock, per metre of the straight line
    charge_per_s : in a dock
    """

    draw_per_s: float
    way_per_m: float
    charge_per_s: float
    _doing: str = ""
    _since_s: float = 0.0
    _charge: float = 0.0

    def note(self, doing: str, charge: float, now_s: float) -> None:
        """Take a report in: the robot is at "work", it "charges", or "" anything else."""
        if doing != self._doing or not doing:
            self._doing, self._since_s, self._charge = doing, now_s, charge
            return
        passed_s = now_s - self._since_s
        if passed_s < WINDOW_S:
            return
        rate = (charge - self._charge) / passed_s
        if doing == "work" and rate < 0.0:
            self.draw_per_s += SHARE * (-rate - self.draw_per_s)
        elif doing == "charges" and rate > 0.0:
            self.charge_per_s += SHARE * (rate - self.charge_per_s)
        self._since_s, self._charge = now_s, charge

    def note_way(self, spent: float, straight_m: float) -> None:
        """Learn from a way to a dock that began `straight_m` from it."""
        if straight_m < 1.0 or spent <= 0.0:
            return
        per_m = spent / straight_m
        self.way_per_m += (per_m - self.way_per_m) * (1.0 if per_m > self.way_per_m else WAY_FALLS)

    def way(self, straight_m: float) -> float:
        """Return what a way to a dock takes."""
        return straight_m * self.way_per_m + DOCKING_S * self.draw_per_s

    def lasts_s(self, charge: float, reserve: float, straight_m: float) -> float:
        """Return for how long a robot can work on before it must go; negative: it should have gone."""
        return (charge - reserve - self.way(straight_m)) / self.draw_per_s

    def charges_s(self, charge: float, until: float) -> float:
        """Return how long it takes to charge it."""
        return max(0.0, until - charge) / self.charge_per_s
