"""The page on the web: only CloudFront reads the bucket, and responses have security headers."""

from __future__ import annotations

from typing import Any

import pytest

from iort_contract.page import HEADERS, pubnub_address, security_policy
from stacks.settings import Settings


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    from aws_cdk import App

    from stacks.site import Site

    app = App()
    Site(app, Settings(live_transport="pubnub"))
    template: dict[str, Any] = app.synth().get_stack_by_name("iort-site").template
    return template


def of(site: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [each["Properties"] for each in site["Resources"].values() if each["Type"] == kind]


def test_the_site_has_neither_assets_nor_functions(site):
    assert {each["Type"] for each in site["Resources"].values()} == {
        "AWS::S3::Bucket",
        "AWS::S3::BucketPolicy",
        "AWS::CloudFront::Distribution",
        "AWS::CloudFront::OriginAccessControl",
        "AWS::CloudFront::ResponseHeadersPolicy",
    }


def test_only_this_distribution_reads_the_private_bucket(site):
    (bucket,) = of(site, "AWS::S3::Bucket")
    assert all(bucket["PublicAccessBlockConfiguration"].values())
    (policy,) = of(site, "AWS::S3::BucketPolicy")
    allowed = [each for each in policy["PolicyDocument"]["Statement"] if each["Effect"] == "Allow"]
    assert [(each["Action"], each["Principal"]) for each in allowed] == [
        ("s3:GetObject", {"Service": "cloudfront.amazonaws.com"})
    ]
    (distribution,) = (
        n for n, r in site["Resources"].items() if r["Type"] == "AWS::CloudFront::Distribution"
    )
    assert {"Ref": distribution} in allowed[0]["Condition"]["StringEquals"]["AWS:SourceArn"]["Fn::Join"][1]


def test_the_site_uses_tls_and_the_headers_of_the_pages_own_server(site):
    (distribution,) = of(site, "AWS::CloudFront::Distribution")
    behaviour = distribution["DistributionConfig"]["DefaultCacheBehavior"]
    assert behaviour["ViewerProtocolPolicy"] == "redirect-to-https"
    assert behaviour["AllowedMethods"] == ["GET", "HEAD"]
    (headers,) = of(site, "AWS::CloudFront::ResponseHeadersPolicy")
    security = headers["ResponseHeadersPolicyConfig"]["SecurityHeadersConfig"]
    policy = security["ContentSecurityPolicy"]["ContentSecurityPolicy"]
    assert policy == security_policy(pubnub_address())
    assert security["ReferrerPolicy"]["ReferrerPolicy"] == HEADERS["Referrer-Policy"]
    assert security["ContentTypeOptions"]["Override"] is True
    assert security["StrictTransportSecurity"]["AccessControlMaxAgeSec"] == 365 * 86_400
    custom = headers["ResponseHeadersPolicyConfig"]["CustomHeadersConfig"]["Items"]
    assert {each["Header"]: each["Value"] for each in custom} == {
        "Cross-Origin-Resource-Policy": HEADERS["Cross-Origin-Resource-Policy"]
    }


def test_without_pubnub_the_page_connects_to_aws_iot_and_cognito_of_its_region_only(deployment, reader):
    template = deployment(drivers=True, site=True, site_robots=["car1"]).templates["iort-site"]
    (headers,) = of(template, "AWS::CloudFront::ResponseHeadersPolicy")
    security = headers["ResponseHeadersPolicyConfig"]["SecurityHeadersConfig"]
    aws = "${AWS::Region}.${AWS::URLSuffix}"
    wanted = security_policy(f"https://cognito-identity.{aws}", f"wss://*.iot.{aws}")
    assert reader.text(security["ContentSecurityPolicy"]["ContentSecurityPolicy"]) == wanted


def test_the_site_is_optional(synthesized):
    assert "site" not in synthesized.templates
