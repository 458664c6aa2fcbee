"""The pattern sequence as data, its file, and its messages. Imports `sl_common` only."""
