"""Scores of a stream against its recording and the ground truth."""
