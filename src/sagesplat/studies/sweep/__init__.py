"""Many runs from one small file."""
