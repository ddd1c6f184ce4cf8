"""What one policy for all sheep is worth."""
