"""The ``gshell`` shape plugin."""
