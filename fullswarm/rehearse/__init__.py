"""Rehearses faults."""
