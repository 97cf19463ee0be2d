"""Attackers beside a mock swarm's honest nodes (`hostile` in a scenario, docs/evaluation/attackers.md)."""
