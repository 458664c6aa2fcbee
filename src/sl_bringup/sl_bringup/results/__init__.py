"""What a scan or an evaluation leaves: files, pictures, reports, tables."""
