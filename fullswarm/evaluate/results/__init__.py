"""Results: what came of an experiment, for people and programs. In: a results folder. Out: index, tables, report.

``folder.py`` reads the directories of the trials, which are the truth. All else is made of them and can be made
again: ``index.py`` (SQLite), ``export.py`` (files for other programs), ``compare.py`` (paired by seed),
``report.py`` (one HTML file), ``plots.py`` and ``maps.py`` (its figures).

Further files:

``commands.py``      What `fullswarm results` does
``coverage_map.py``  `fullswarm results map`: what the swarm of one trial has covered, as a map that ROS's map_server
                     reads
``quantities.py``    What is measured: names, titles and units
``sample.py``        Trials sorted for tables and figures: conditions (engine, limits, network), scenarios, sizes,
                     behaviours
``statistics.py``    Statistics of trials: description with intervals, and paired comparison by seed
``svg.py``           Figures as SVG text: small, the same bytes for the same data, fit to stand inside an HTML page
``tables.py``        The report's tables, as data: for HTML and for Markdown
"""

from fullswarm.evaluate.results.folder import Folder, Problem, StoredTrial, read_folder, read_records
from fullswarm.evaluate.results.report import write_plots, write_report

__all__ = ["Folder", "Problem", "StoredTrial", "read_folder", "read_records", "write_plots", "write_report"]
