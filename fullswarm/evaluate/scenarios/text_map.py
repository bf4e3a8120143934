"""A scenario as text: what stands where, one character for a cell."""

from __future__ import annotations

from fullswarm.evaluate.coverage_map import occupied_cells
from fullswarm.evaluate.scenarios import Box, Scenario
from fullswarm.perf.coverage import GridFrame

COLUMNS = 64
"""Width of the map; a character is about twice as high as wide, so two cells side by side are one square."""

BOX, ROBOT, GOAL, START, FLOOR = "#", "R", "o", ".", " "
LEGEND = f"{BOX} box or wall   {ROBOT} robot   {GOAL} goal   {START} where robots start"


def text_map(scenario: Scenario, boxes: tuple[Box, ...], robots: list[tuple[float, float]]) -> str:
    """Return the arena seen from above, y upwards, with a frame where it has walls."""
    x_min, y_min, x_max, y_max = scenario.bounds_m
    cell_x = max((x_max - x_min) / COLUMNS, (y_max - y_min) / COLUMNS)
    columns, rows = max(1, round((x_max - x_min) / cell_x)), max(1, round((y_max - y_min) / (2 * cell_x)))
    # A character is a box when boxes reach into a sixth of its 3 x 6 parts: thin walls stay, most gaps stay open.
    parts = occupied_cells(GridFrame(x_min, y_min, cell_x / 3, 6 * rows, 3 * columns), boxes)
    solid = parts.reshape(rows, 6, columns, 3).mean(axis=(1, 3)) >= 1 / 6 - 1e-9
    lines = []
    for row in reversed(range(rows)):
        line = []
        for column in range(columns):
            x, y = x_min + (column + 0.5) * cell_x, y_min + (row + 0.5) * 2 * cell_x
            line.append(BOX if solid[row, column] else _floor(scenario, x, y))
        lines.append(line)
    for x, y in robots:
        column, row = int((x - x_min) / cell_x), int((y - y_min) / (2 * cell_x))
        if 0 <= column < columns and 0 <= row < rows:
            lines[rows - 1 - row][column] = ROBOT
    side, corner = (BOX, BOX) if scenario.walls else ("|", "+")
    edge = corner + (BOX if scenario.walls else "-") * columns + corner
    return "\n".join([edge, *(f"{side}{''.join(line)}{side}" for line in lines), edge])


def _floor(scenario: Scenario, x: float, y: float) -> str:
    goal_x, goal_y = scenario.goal.centre_m
    if (x - goal_x) ** 2 + (y - goal_y) ** 2 <= scenario.goal.radius_m**2:
        return GOAL
    left, low, right, high = scenario.spawn.region_m
    return START if left <= x <= right and low <= y <= high else FLOOR
