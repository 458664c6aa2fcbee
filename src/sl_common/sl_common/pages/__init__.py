"""Pages of reports: one layout and one style for all of them."""
