"""The command line: one file a command, found by `host.cli.main`."""
