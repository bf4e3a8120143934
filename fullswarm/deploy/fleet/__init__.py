"""Installs and updates robots over SSH: deploy, update in waves, roll back, show.

``commands.py``      `deploy`, `update`, `rollback`, `reboot`, `fleet`, `logs`, `shell`
``rollout.py``       which robots may switch when: canary, waves, stop at k failures
``robot_update.py``  the steps on one robot: install, ship, switch under guard, commit or roll back
``releases.py``      which release fits a robot, what the robot lacks of it, what each robot should run
``facts.py``         one round trip: what a robot is and what it runs
``login.py``         pinned host keys, fleet key, jump hosts, and the questions that a person answers
``remote.py``        one robot's computer over asyncssh: commands with time limits, untrusted answers

In: a fleet file, a release and keys. Out: robots that run it, and a table with the outcome and the remedy for
each. What a robot does with a release (signature, links, guard, rollback) is the script ``fullswarm-robot`` on the
robot: a robot needs nothing of this package to roll back.
"""
