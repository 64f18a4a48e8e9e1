"""A procedural capture of a small garden: photos, poses, points and label images made on the spot."""
