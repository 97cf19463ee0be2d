"""Spare copies: who keeps one, who is offered one, who has a good one when another is corrupt."""
