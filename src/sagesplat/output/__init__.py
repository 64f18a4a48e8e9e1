"""What a run gives away: splat files, tables, figures and the report."""
