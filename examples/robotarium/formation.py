"""Formation by a weighted Laplacian: six robots form a rectangle of 0.8 by 0.4 m."""

import numpy as np
import rps.robotarium as robotarium
from rps.utilities.barrier_certificates import *
from rps.utilities.graph import *
from rps.utilities.transformations import *

STEPS = 600  # 20 s
GAIN = 4.0
SIDE = 0.4
# Robots 0, 1, 2 and 3, 4, 5 in two rows; neighbours in the cycle, and the two diagonals of each square.
corners = SIDE * np.array([[0.0, 1.0, 2.0, 2.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]])
N = corners.shape[1]
L = cycle_GL(N)
for first, second in ((1, 4), (0, 4), (1, 5), (1, 3), (2, 4)):
    L[[first, second], [second, first]] = -1.0
    L[first, first] += 1.0
    L[second, second] += 1.0
length = np.linalg.norm(corners[:, :, None] - corners[:, None, :], axis=0)

start = np.array(
    [[-0.8, 0.0, 0.7, 0.9, 0.1, -0.6], [-0.6, -0.4, -0.7, 0.5, 0.3, 0.6], [0.2, 1.0, 2.0, -2.5, -1.0, -0.3]]
)
r = robotarium.Robotarium(number_of_robots=N, show_figure=False, initial_conditions=start)
certificate = create_single_integrator_barrier_certificate_with_boundary()
si_to_uni_dyn = create_si_to_uni_dynamics()

for _ in range(STEPS):
    x = r.get_poses()
    dxi = np.zeros((2, N))
    for i in range(N):
        for j in topological_neighbors(L, i):
            offset = x[:2, j] - x[:2, i]
            dxi[:, i] += GAIN * (offset @ offset - length[i, j] ** 2) * offset
    dxi = certificate(dxi, x[:2])
    r.set_velocities(np.arange(N), si_to_uni_dyn(dxi, x))
    r.step()

x = r.get_poses()
r.call_at_scripts_end()
