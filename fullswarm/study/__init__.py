"""Human-swarm studies: participants operate a swarm from the console under several conditions, in a balanced order.

``file.py``      the study file: participants, conditions, probes, questionnaire
``order.py``     which participant meets which condition when: Latin square, Williams design, random
``folder.py``    the folder of a study: its sealed key, the trials, what comes next
``session.py``   runs one trial: the swarm of the condition, and the console in study mode
``measures.py``  what is computed of a trial: interaction time, neglect, fan-out, switches, probes, workload
``tidy.py``      all measures of all trials as one table

The trial itself, from the briefing to the questionnaire, is conducted by the console's process: ``console/study.py``
of :mod:`fullswarm.operator`.
"""
