"""The fleet over SSH: install, update in waves, roll back, look.

``remote.py``     one robot's computer over asyncssh: run a command, feed it, hear its answer, never hang
``login.py``      from a robot of the fleet file to such a connection: pinned key, fleet key, jump hosts
``hostkeys.py``   which host key is pinned for which robot, and what to say when it is another one
``untrusted.py``  what a robot says is bytes from a stranger: bounded, strict, without control characters
``facts.py``      one round trip: what a robot is and what it runs
``choose.py``     which release of the store fits it
``ship.py``       what it lacks, packed once for all robots that lack the same
``steps.py``      one robot, one step: install, stage, switch under guard, confirm, roll back
``rollout.py``    which robots may switch when: canary, waves, stop at k failures. Pure: no network, no clock
``work.py``       what a rollout asks of one robot; ``verdict.py`` after the switch: kept, or taken back
``update.py``     performs a rollout
``desired.py``    what each robot should run, kept on the base for robots that were away
``commands.py``   deploy, update; ``visit.py`` rollback, reboot; ``status.py`` fleet; ``terminal.py`` logs, shell

In flow a fleet file, a release and keys; out flow robots that run it, and a table that says of each what happened
and what to do. What a robot does with a release (signature, links, guard, rollback) is the script
``fullswarm-robot`` on the robot: nothing here is needed for a robot to go back by itself.

Further files:

``people.py``  Robots by name, keys, and the questions that only a person can answer
``report.py``  The result of a command, robot by robot: what happened, and what to do
"""
