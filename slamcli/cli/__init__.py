"""The command line, and the only package that uses click; each command calls `slamcli.run`."""
