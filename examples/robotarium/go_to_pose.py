"""Go to pose: five robots change places, each to a pose of its own, behind a barrier certificate for unicycles."""

import numpy as np
import rps.robotarium as robotarium
from rps.utilities.barrier_certificates import *
from rps.utilities.controllers import *
from rps.utilities.misc import *

MOST_STEPS = 900  # 30 s
start = np.array([[-1.0, 0.9, 0.0, -0.5, 0.6], [-0.5, 0.4, 0.7, 0.6, -0.7], [0.0, 3.0, -1.5, -0.8, 2.0]])
goals = np.array([[1.1, -1.1, 0.1, 0.7, -0.6], [0.5, -0.3, -0.6, -0.2, 0.4], [0.5, 3.0, -1.5, 0.0, 2.2]])

N = start.shape[1]
r = robotarium.Robotarium(number_of_robots=N, show_figure=False, initial_conditions=start)
controller = create_clf_unicycle_pose_controller()
certificate = create_unicycle_barrier_certificate()

for _ in range(MOST_STEPS):
    x = r.get_poses()
    if np.size(at_pose(x, goals, position_error=0.02, rotation_error=0.1)) == N:
        break
    r.set_velocities(np.arange(N), certificate(controller(x, goals), x))
    r.step()

r.call_at_scripts_end()
