"""From measured quality to plans: levels, observations, quality models, plans, composed scenes."""
