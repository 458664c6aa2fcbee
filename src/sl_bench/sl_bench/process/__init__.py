"""The process that runs the bench: settings, emulators, control socket."""
