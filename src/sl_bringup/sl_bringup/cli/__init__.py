"""The commands of ``slrig``, one file each."""
