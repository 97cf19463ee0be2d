"""The lab: mock swarms with their medium, disks and attackers, fleets of processes, replays, experiments.

Nothing that flies imports it.
"""
