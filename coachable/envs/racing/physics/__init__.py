"""Batched physics of cars without control flow: tyres, powertrain, body and contacts."""
