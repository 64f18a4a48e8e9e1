"""What is fetched from elsewhere: weights, and scenes out of the archives of the field."""
