"""A procedural capture of a small garden: rendered photos, poses, points and label images."""
