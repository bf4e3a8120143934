"""Results: what came of an experiment, for people and programs. In: a results folder. Out: index, tables, report.

``folder.py`` reads the directories of the trials, which are the truth. All else is made of them and can be made
again: ``index.py`` (SQLite), ``export.py`` (files for other programs), ``compare.py`` (paired by seed),
``report.py`` (one HTML file), ``plots.py`` and ``maps.py`` (its figures).
"""

from fullswarm.evaluate.results.folder import Folder, Problem, StoredTrial, read_folder, read_records
from fullswarm.evaluate.results.report import write_plots, write_report

__all__ = ["Folder", "Problem", "StoredTrial", "read_folder", "read_records", "write_plots", "write_report"]
