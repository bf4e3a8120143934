"""The null make: ``null://<id>``, a robot that is nowhere. The smallest legal driver, and the template for new ones."""
