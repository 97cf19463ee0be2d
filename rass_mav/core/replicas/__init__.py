"""Replicas: which node keeps one, which is offered one, and which has a good one when another is corrupt."""
