"""What a domain adds to the library: its styles, metrics, pictures, evaluations."""
