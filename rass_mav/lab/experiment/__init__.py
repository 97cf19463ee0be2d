"""The paper's experiments and ours: many runs of the mock swarm, and the resulting tables and figures."""
