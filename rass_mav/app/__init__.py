"""The running program: configuration file, asyncio driver, local control socket."""
