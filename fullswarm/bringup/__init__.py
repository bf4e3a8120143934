"""From a cable to a robot that may drive: find it, test it, check this machine and the robot's computer.

=========================== ==================================================================
file                        what it does
=========================== ==================================================================
``find.py``                 `robots find`: asks every port which robot is there
``robot_test.py``           `robots test`: drives one robot a little; ``robot_test_steps.py``: its steps
``robot_check.py``          `robots check`: the published check of drivers
``bench.py``                opens one robot for a person, closes it on Ctrl-C
``doctor.py``               `doctor`: this machine, the hub and the robots of a fleet file
``machine.py``              the machine's own checks; ``gamepad.py``: those of gamepads
``preflight.py``            `doctor --robot`: one robot before it drives; over SSH (``preflight_ssh.py``, judged by
                            ``preflight_board.py``), on the bus (``preflight_bus.py``), by its e-stop
                            (``preflight_estop.py``)
``checks.py``               one line of a check-up, and how all of them are shown
``emulate.py``              `emulate`: one emulated robot on a real port; ``injected_faults.py``: faults that are typed
``info.py``                 `info`: what a bug report needs
``init.py``                 `init`: a lab's folder, made of ``lab/``
=========================== ==================================================================
"""
