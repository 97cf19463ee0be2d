"""Where sources of radiation are, from the readings that have arrived (docs/how-to/sources.md). It needs numpy, which
no other
room imports."""
