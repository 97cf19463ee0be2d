"""The paper's experiments and ours: many runs of the mock swarm, and the tables and figures made of them."""
