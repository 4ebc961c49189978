"""Commands about a skin and this machine: costs, designs, training."""
