"""The web console in a real browser, on a real swarm: what issue 6 promises an operator."""
