"""What runs beside a base, in a process of its own: commands for what arrives, figures for Prometheus, a database,
events for TAK."""
