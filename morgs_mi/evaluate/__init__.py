"""Scores of a stream compared with its recording and the ground truth."""
