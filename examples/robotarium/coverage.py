"""Coverage with barrier certificates: each of six robots moves to the centroid of its Voronoi cell (Lloyd's method)."""

import numpy as np
import rps.robotarium as robotarium
from rps.utilities.barrier_certificates import *
from rps.utilities.misc import *
from rps.utilities.transformations import *

STEPS = 750  # 25 s
GAIN = 2.0
start = np.array(
    [[-1.4, -1.2, -1.0, -1.38, -1.15, -0.95], [-0.8, -0.78, -0.83, -0.6, -0.55, -0.62], [0.0, 0.5, 1.0, 1.0, 0.7, 0.3]]
)
N = start.shape[1]
r = robotarium.Robotarium(number_of_robots=N, show_figure=False, initial_conditions=start)
certificate = create_single_integrator_barrier_certificate_with_boundary()
si_to_uni_dyn, uni_to_si_states = create_si_to_uni_mapping()

across, along = np.meshgrid(np.arange(-1.5875, 1.6, 0.025), np.arange(-0.9875, 1.0, 0.025))
grid = np.stack([across.ravel(), along.ravel()])

for _ in range(STEPS):
    x = r.get_poses()
    points = uni_to_si_states(x)
    nearest = np.argmin(((grid[:, None, :] - points[:, :, None]) ** 2).sum(axis=0), axis=0)
    dxi = np.zeros((2, N))
    for i in range(N):
        cell = grid[:, nearest == i]
        if cell.size:
            dxi[:, i] = GAIN * (cell.mean(axis=1) - points[:, i])
    dxi = certificate(dxi, points)
    r.set_velocities(np.arange(N), si_to_uni_dyn(dxi, x))
    r.step()

x = r.get_poses()
r.call_at_scripts_end()
