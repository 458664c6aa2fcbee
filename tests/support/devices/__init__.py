"""Devices for tests: fakes, and the emulators with their drivers."""
