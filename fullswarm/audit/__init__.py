"""The audit log: who asked what of which robots, when, and with what result, in a chain of hashes.

A log is a folder of text files with one JSON object per line. Each entry holds the hash of the one before it, so that
a changed, removed or reordered entry breaks the chain; ``head.json`` beside them holds the number and the hash of the
newest entry, so that entries cut off at the end are missed too.

``log.py``     appends entries: hashes, files, rotation, what a full disk does
``read.py``    reads entries back: filters, and entries as they are added
``verify.py``  checks a log, with code of its own
"""
