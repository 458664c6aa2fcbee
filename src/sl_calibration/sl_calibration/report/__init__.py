"""What a calibration leaves for others: pages, pictures, Table 1, exported files."""
