"""Tyre-limited car racing in batched torch: wear, fuel, several cars, three families of driving style."""
