"""The subcommands of ``sitl``, a module each, loaded when it is called."""
