"""Systems that come with grounded, by the same door as the user's own."""
