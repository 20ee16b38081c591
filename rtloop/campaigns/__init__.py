"""Campaigns: one configuration on thousands of simulated rigs that differ, with figures and a verdict for each rig.

`campaign_file` reads CAMPAIGN.toml, `samples` draws the uncertain parameters, `case` runs one rig, `unit` runs many in
a worker, `coordinator` hands units to workers, `store` keeps their results. It may import design and the rooms below
it. Begin reading with `case`.
"""
