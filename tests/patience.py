"""How long a test waits for what must come."""

#: Seconds. Nothing takes so long, however busy the machine is: it only ends what hangs.
PATIENCE_S = 300.0
