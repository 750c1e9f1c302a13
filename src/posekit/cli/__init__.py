"""The command line: parse, call, print. Layer 6."""
