"""How well the swarm did (paper II.F). In: poses and contacts of the robots. Out: numbers, files.

======================  ==========================================================  =============
file                    what it holds                                               runs in
======================  ==========================================================  =============
``calculators.py``      distance, contact events and covered cells per robot        agent
``energy.py``           what driving costs, a proxy                                 agent
``metrics.py``          the table of metrics: columns, quantities, their meaning    core
``robot_tally.py``      joins those columns; ``shape.py``: order, spacing, …        core
``truth.py``            what the true bodies did; ``supervisor.py`` publishes it    base station
``coverage.py``         the coverage grid and how it travels on the bus             agent, core
``summarizers.py``      measurements of all hosts → a Summary per metric            core
``termination.py``      when a trial is over                                        core
``performance_node.py`` newest summaries → ``performance.json``, tables             core, operator
======================  ==========================================================  =============

Nothing is imported here, so that a robot loads its calculators without the rest.

Further files:

``tallies.py``  what a summarizer needs of a tally, and the tally of coverage
"""
