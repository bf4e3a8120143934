"""The ``fullswarm`` command: one file per noun that parses, calls and prints. No other package imports this one.

================== ==================================================================================
file               commands
================== ==================================================================================
``main.py``        puts all commands together; `demo`, `up`, `init`, `info` and the single processes
``request.py``     `request`, `mock`, `drive`, `stop`
``mission.py``     `request FILE.toml`, `mission show|pause|resume|abort|confirm`
``estop.py``       `estop`
``status.py``      `status`, `watch`, `behaviours`, `robots` without a verb
``tryout.py``      `try`
``params.py``      `params get|set|history|watch`
``leases.py``      `leases`, `leases hold`
``joystick.py``    `joystick`, `joystick list|test|map`
``audit.py``       `audit show|verify`
``record.py``      `record start|stop|info|repair`
``replay.py``      `replay`
``mcp.py``         `mcp`
``guide.py``       `guide`
``schema.py``      `schema`
``viewer.py``      `viewer foxglove|layout|rerun`
``metrics.py``     `metrics`
``ros.py``         `ros bridge`
``console.py``     `console`, `console tokens add|list|revoke`
``robots.py``      `robots find|test|check`, `doctor`, `emulate`
``fixes.py``       `fixes`, `fixes record|play`
``track.py``       `track init|sheets|calibrate|run`, `track --video`
``experiment.py``  `experiment run|trial|watch|replay`
``rehearse.py``    `rehearse`
``results.py``     `results list|show|export|map|compare|report|index`
``scenario.py``    `scenario list|show|import|export`
``study.py``       `study check|run|status|export|unblind`
``bundle.py``      `bundle`
``keys.py``        `keys`, `keys init|issue|renew|revoke|list`
``signing.py``     `signing list|rotate|revoke|root`
``deploy.py``      `deploy`, `update`, `rollback`, `fleet`, `logs`, `shell`, `reboot`
``flash.py``       `flash`
``options.py``     the decorator of all commands; options that several commands have
``panels.py``      formats help as plain text
``values.py``      parses `KEY=VALUE` and values
``completion.py``  shell completion
================== ==================================================================================

Only typer is imported with these files. What a command needs is imported when it runs, so that help appears at once.
"""
