"""Brings up a robot, from a cable to the permission to drive: find it, test it, check this machine and its computer.

=========================== ==================================================================
file                        what it does
=========================== ==================================================================
``find.py``                 `robots find`: asks every port which robot is there
``robot_test.py``           `robots test`: drives one robot a little, step by step
``robot_check.py``          `robots check`: the published check of drivers
``doctor.py``               `doctor`: this machine, the hub and the robots of a fleet file
``machine.py``              the machine's own checks: Python, extras, ports, gamepads, clocks, disk, processor
``preflight.py``            `doctor --robot`: one robot before it drives: on the bus, and by its e-stop
``preflight_ssh.py``        the same over SSH: its computer's card, power, heat, clock, port, software, units
``certificates.py``         the certificates that a fleet needs: issues all, checks that none is missing or expires
``checks.py``               one line of a check-up, and how all of them are shown
``emulate.py``              `emulate`: one emulated robot on a real port, with faults on request
``info.py``                 `info`: what a bug report needs
``guide.py``                `guide`: one page on how to use and extend fullswarm
``init.py``                 `init`: a lab's folder, made of ``lab/``
``new_behaviour.py``        `behaviours new`: a law, its record and its test, made of ``lab/``
=========================== ==================================================================
"""
