"""Weights judged on frames that they never saw: figures with intervals, and costs."""
