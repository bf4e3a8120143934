"""The ``fullswarm`` command: one file per noun that parses, calls and prints. No other package imports this one.

================== ==================================================================================
file               commands
================== ==================================================================================
``main.py``        puts the applications together; `demo`, `up`, `init`, `info` and the single processes
``operate.py``     `request`, `stop`, `estop`, `drive`, `mock`, `status`, `watch`, `robots`, `behaviours`
``params.py``      `params get|set|list`
``leases.py``      `leases`
``joystick.py``    `joystick`
``console.py``     `console`
``robots.py``      `robots find|test|check`, `doctor`, `emulate`
``experiment.py``  `experiment run|trial|watch|replay`
``results.py``     `results`
``scenario.py``    `scenario`
``deploy.py``      puts `release.py` (`bundle`, `keys`), `fleet.py` (`deploy`, `update`, ...) and `flash.py` together
``options.py``     options that several commands have
``completion.py``  what TAB offers
================== ==================================================================================

Only typer is imported with these files. What a command needs is imported when it runs, so that help appears at once.
"""
