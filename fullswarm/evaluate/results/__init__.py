"""Results of an experiment, for people and programs. In: a results folder. Out: index, tables, report.

The directories of the trials are the source; everything else is derived from them and can be rebuilt.

``folder.py``      the results folder: ``experiment.json`` and the trials in it
``commands.py``    what `fullswarm results` does
``quantities.py``  what is measured: names, titles and units; a new column of tables and reports is defined here
``sample.py``      trials sorted for tables and figures: by condition (engine, limits, network), scenario and size
``statistics.py``  description with intervals, and comparison, paired by seed or of two groups
``compare.py``     two folders, or two values of a field, paired by seed
``headline.py``    the main comparison of an experiment and its effect
``report.py``      the report, one HTML file (``report.html.j2``): its sections and tables
``figures.py``     its figures, as SVG
``cards.py``       its cards of single trials: figures, files, commands
``audit.py``       what `fullswarm results audit` does: compares results with recounts
``recount.py``     counts contacts, arrivals and commands again; shares no code with the referee
``index.py``       the trials as SQLite
``export.py``      the trials as files for other programs
``mlflow.py``      the trials as runs in MLflow
"""

from fullswarm.evaluate.results.folder import Folder, Problem, StoredTrial, read_folder, read_records
from fullswarm.evaluate.results.report import write_plots, write_report

__all__ = ["Folder", "Problem", "StoredTrial", "read_folder", "read_records", "write_plots", "write_report"]
