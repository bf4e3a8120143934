"""An outside behaviour: the law is ``orbit.py``, its record ``orbit.toml`` beside the package."""
