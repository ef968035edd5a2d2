"""Cars: tyres, powertrain, body, contacts; batched, without control flow."""
