"""Consensus: eight robots agree on a place over a cycle graph, and gather there as far as the certificate lets them."""

import numpy as np
import rps.robotarium as robotarium
from rps.utilities.barrier_certificates import *
from rps.utilities.graph import *
from rps.utilities.transformations import *

STEPS = 600  # 20 s
start = np.array(
    [
        [-1.3, -0.6, 0.2, 1.0, 1.3, 0.6, -0.1, -1.0],
        [-0.3, -0.8, -0.7, -0.5, 0.2, 0.7, 0.8, 0.5],
        [0.3, 1.4, 2.0, 2.5, -2.8, -1.9, -1.5, -0.5],
    ]
)
N = start.shape[1]
r = robotarium.Robotarium(number_of_robots=N, show_figure=False, initial_conditions=start)
certificate = create_single_integrator_barrier_certificate_with_boundary()
si_to_uni_dyn, uni_to_si_states = create_si_to_uni_mapping()
L = cycle_GL(N)

for _ in range(STEPS):
    x = r.get_poses()
    points = uni_to_si_states(x)
    dxi = np.zeros((2, N))
    for i in range(N):
        neighbours = topological_neighbors(L, i)
        dxi[:, i] = np.sum(points[:, neighbours] - points[:, [i]], axis=1)
    dxi = certificate(dxi, points)
    r.set_velocities(np.arange(N), si_to_uni_dyn(dxi, x))
    r.step()

x = r.get_poses()
r.call_at_scripts_end()
